"""The data of studies: blocks that say what was measured of a model, files that are read and written."""
