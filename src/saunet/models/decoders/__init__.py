"""Registered decoders: feature maps -> disparity pyramid."""
