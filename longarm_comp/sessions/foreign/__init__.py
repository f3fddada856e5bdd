"""Files of other programs (CSV, XLSX): what their columns mean, and the session they hold."""
