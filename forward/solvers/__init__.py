"""Finding equilibria of a discrete system and testing their stability; nothing here knows finite elements."""
