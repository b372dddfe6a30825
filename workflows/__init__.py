"""What is done to a capture, step by step."""
