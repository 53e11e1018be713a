"""What acts on a body."""
