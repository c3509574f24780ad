"""Registered data modules."""
