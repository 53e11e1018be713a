"""What makes a posterior doubtful, and comparisons of several models."""
