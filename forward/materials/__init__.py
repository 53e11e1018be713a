"""Strain energies, measures of deformation, and the response of a material point."""
