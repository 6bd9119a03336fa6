"""The closed loop: I/O node and plant on one side, the ECU on the other, tick by tick, in process or over a bus."""
