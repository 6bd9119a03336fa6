"""What travels between the nodes: frames, E2E, buses under one interface, the hub, the object dictionary and SDO."""
