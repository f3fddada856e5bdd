"""Files of a diagnosis: report.json for programs, report.html and plots for people."""
