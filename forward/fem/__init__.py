"""Finite elements: equations, their solution and derivatives, and what both cost."""
