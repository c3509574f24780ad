"""Driving video as training samples."""
