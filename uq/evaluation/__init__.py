"""Where models are evaluated and what is kept of it: blocks, groups of ranks, files."""
