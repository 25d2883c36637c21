"""The work of the commands. The command line imports each module when its command runs."""
