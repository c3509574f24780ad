"""Registered loss terms."""
