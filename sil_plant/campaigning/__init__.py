"""Campaigns: many arms drawn from distributions, commissioned and operated, and what they say together."""
