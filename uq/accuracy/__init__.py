"""The error that a mesh makes of what a study estimates."""
