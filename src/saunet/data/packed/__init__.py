"""Whole data sets in a few large files, which are read in parts from a disk or from an object store."""
