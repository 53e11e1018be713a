"""Bodies that turn in a report: their surfaces, what is seen on them, and how they travel in the page."""
