"""Training: the LightningModule, its optimiser recipe and callbacks."""
