"""What acts on a body: loads and prescribed displacements."""
