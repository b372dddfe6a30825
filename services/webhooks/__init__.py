"""Webhooks: who sends them, and which addresses they may reach."""
