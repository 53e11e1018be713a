"""Finite elements: equations, their solution and derivatives, and the cost of both."""
