"""One tolerance for all errors, and meshes that are refined for it or before a study."""
