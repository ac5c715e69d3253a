"""Maximisers side by side: on functions whose maximum is known, and on landscapes of ``g`` with a certified one."""
