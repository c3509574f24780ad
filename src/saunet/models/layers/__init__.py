"""Network blocks that encoders and decoders are made of."""
