"""Evaluation of models, and storage of the results: blocks, rank groups, files."""
