"""Training of the map predictor: data, models, training loop, scores, ONNX export."""
