// The documentation of the API, drawn by Swagger UI from openapi.json.
globalThis.SwaggerUIBundle({ url: "openapi.json", dom_id: "#docs", deepLinking: true, validatorUrl: null });
