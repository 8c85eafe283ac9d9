"""The paper's tables as jobs: what is missing is run, and a page says what holds here (`magnet report`)."""
