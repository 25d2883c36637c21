"""What every other folder uses: errors, checks of input, threads."""
