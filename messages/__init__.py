"""What nodes say to one another: typed messages, the topic table, the wire, the bus, the bag."""
