"""Whole runs as functions: commissioning, operation, and the fault matrix."""
