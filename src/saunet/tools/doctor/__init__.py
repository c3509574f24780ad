"""Checking a data set before hours of training: its content, its problems, and what to do about them."""
