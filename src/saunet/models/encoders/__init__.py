"""Registered encoders: image -> feature maps."""
