"""What is kept, and how it is laid out."""
