"""From checkpoint to depth pictures."""
