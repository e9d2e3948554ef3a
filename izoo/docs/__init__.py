"""The documentation: its pages, what is generated for them (:mod:`izoo.docs.pages`), and runnable examples."""
