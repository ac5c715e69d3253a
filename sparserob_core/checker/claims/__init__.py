"""What a run claims, one claim after another."""
