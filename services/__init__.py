"""The processes that people and machines talk to."""
