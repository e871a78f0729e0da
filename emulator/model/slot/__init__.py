"""What happens in a slot: process, packets, links, beliefs."""
