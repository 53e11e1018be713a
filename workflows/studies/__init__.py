"""The kinds of study beside sampling."""
