"""What every room uses: checks of arguments, progress, folders of results, records as files."""
