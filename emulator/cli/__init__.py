"""The command line: what there is to type, what it prints, and how errors end."""
