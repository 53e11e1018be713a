"""What acts on a body: loads, one file each, and prescribed displacements."""
