"""What a body is made of: its shape and mesh, inclusions in it, random fields over it; no FEniCSx is needed."""
