"""Registered channel attention modules."""
