"""Camera geometry as pure functions on tensors."""
