"""What a run is given: machine file, scenario, profile and faults, read and checked."""
