"""TCP servers, one a port. They read and write the controller; none of them keeps time."""
