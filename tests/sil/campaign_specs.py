"""Parts of campaign specs that several tests write."""

VARY_LOAD_AND_BORE = """[[vary]]
key = "load_kg"
distribution = "uniform"
low = 0
high = 10
[[vary]]
key = "wrist.bore_m"
distribution = "normal"
relative = true
sd = 0.001
"""
