"""Before anything moves: gains and limits proposed for a machine, the linear loop, and what is wrong with a file."""
