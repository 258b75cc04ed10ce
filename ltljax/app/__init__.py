"""The application: scenarios, commands on mesh files, and the command line."""
