"""Reduced models of a body: few modes, few points, the same energies; FEniCSx is needed only to make them."""
