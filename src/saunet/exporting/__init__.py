"""From a trained network to ONNX, torch.export and safetensors, each checked against the original."""
