"""Losses of self-supervised depth."""
