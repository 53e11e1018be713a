"""Reports: pages, tables, pictures, sentences."""
