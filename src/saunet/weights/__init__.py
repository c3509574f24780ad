"""Trained models: found by name, path or hub id, read from files, and those that come with saunet."""
