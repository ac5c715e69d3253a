"""The verification of the worst cases that ``sparserob bound`` writes."""
