"""Jobs over HTTP: their state, events, ETA and what they wait for."""
