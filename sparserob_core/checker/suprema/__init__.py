"""The worst cases that ``sparserob bound`` writes down, derived anew."""
