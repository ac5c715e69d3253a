"""Output on the terminal: tables and printable text; exit statuses."""
