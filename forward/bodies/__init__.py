"""What a body consists of: shape and mesh, inclusions, random fields; no FEniCSx is needed."""
