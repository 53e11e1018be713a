"""Finding equilibria of a discrete system, and whether they are stable; nothing here knows finite elements."""
