"""The report of a results folder: its words and tables, which the terminal prints, and the page that shows them with plots."""
