"""The arm itself: its dynamics, compiled, and its geometry and statics; it knows of no bus and no ECU."""
