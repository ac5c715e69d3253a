"""What the terminal shows: tables and printable text; exit statuses."""
