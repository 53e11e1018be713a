"""The kinds of studies."""
