"""The command line `svkc`."""
