"""Recording: samples in, a log out, with the robustness of specifications beside them."""
