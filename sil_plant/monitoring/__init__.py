"""What a bus tells about the ECU and what is wrong with it; and asking it for modes and moves."""
