"""HTTP itself: bodies, responses, idempotency, browsers, slow clients."""
