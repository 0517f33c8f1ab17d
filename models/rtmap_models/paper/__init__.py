"""The network of the RTMap paper: cameras → bird's-eye map → hybrid queries → answer."""
