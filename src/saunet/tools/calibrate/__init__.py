"""Camera calibration from pictures of a board."""
