"""The results directory."""
