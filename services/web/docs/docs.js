// The API's documentation, drawn by Swagger UI from what the service says of itself.
globalThis.SwaggerUIBundle({ url: "openapi.json", dom_id: "#docs", deepLinking: true, validatorUrl: null });
