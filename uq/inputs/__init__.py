"""Random parameters: distributions, their joint law, designs and quadrature."""
