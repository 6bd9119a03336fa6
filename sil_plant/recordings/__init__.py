"""What was on a bus, kept in files and given to the firmware again."""
