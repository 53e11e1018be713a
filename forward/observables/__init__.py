"""What is asked of a deformed body."""
