"""Models of other programs: Python functions and servers."""
