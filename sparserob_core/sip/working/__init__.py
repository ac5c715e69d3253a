"""What an exchange works with: the imposed constraints, how they are solved, and the accounts of what is known."""
