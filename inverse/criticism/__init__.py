"""What makes a posterior doubtful, and what several models say together."""
