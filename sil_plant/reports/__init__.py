"""Pictures and pages for people: of runs, recordings, machines, campaigns, and of the paper's results."""
