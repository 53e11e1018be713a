"""Measurements: files of them, their errors, their neighbours."""
