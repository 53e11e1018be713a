"""Methods: what a study can do with random parameters, one method in each file."""
