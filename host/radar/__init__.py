"""What a row needs of the radars: to be armed for its pulses, and to say how they are."""
