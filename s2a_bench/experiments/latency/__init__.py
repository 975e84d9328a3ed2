"""What the transport costs, stage by stage."""
