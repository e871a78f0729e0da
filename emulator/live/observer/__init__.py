"""The observer: conducts a live run, joins what the processes report, and hands it on to be scored and recorded."""
