"""Forward models of soft-tissue bodies: specifications without FEniCSx, and finite elements with it."""
