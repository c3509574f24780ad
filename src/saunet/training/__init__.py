"""Training: the LightningModule, its optimizer recipe and callbacks."""
