"""The live page: arm, traces and controls in a browser."""
