"""What results say of the instrument, put to use: an instrument file with what was learned."""
