"""AdaptGNS: a learned particle simulator whose interaction graph adapts to its uncertainty."""
