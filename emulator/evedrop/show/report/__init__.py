"""The report of a results folder: the sentences and tables that the terminal prints, and a page that adds charts."""
