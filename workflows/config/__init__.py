"""Studies as they are written: their blocks, and the mistakes in them."""
