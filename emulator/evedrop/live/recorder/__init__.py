"""The recorder: conducts a live run, joins the reports of all processes, and hands them on to be scored and recorded."""
