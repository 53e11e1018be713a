"""Strain energies, measures of deformation, and what a material is at a point."""
