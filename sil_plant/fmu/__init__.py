"""Our plant and our firmware as FMUs, for other simulation tools."""
