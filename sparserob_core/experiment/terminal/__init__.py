"""What the terminal shows: tables, progress, exit statuses."""
