"""Studies as they are written down: their blocks, and what is wrong with them."""
