"""Commands that talk to a service, through `services.client`."""
