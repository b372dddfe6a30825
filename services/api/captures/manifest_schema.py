"""The JSON Schema of capture.json, for programs that write capture archives and for /docs."""

from typing import Any

from fastapi.responses import JSONResponse

from services.api.context import OwnerContext
from services.api.http.router import Router
from workflows.ingest.manifest import MANIFEST, Manifest

router = Router(tags=["captures"])


class SchemaResponse(JSONResponse):
    """A JSON Schema as an answer."""

    media_type = "application/schema+json"


@router.get("/capture.schema.json", response_class=SchemaResponse)
def get_capture_schema(context: OwnerContext) -> dict[str, Any]:
    """The JSON Schema of `capture.json`, the manifest in a capture's ZIP.

    The same schema is `capture.json` among the schemas of this document.
    """
    return Manifest.model_json_schema()


def components() -> dict[str, Any]:
    """The same schema, as entries for the ``components.schemas`` of an OpenAPI document."""
    schema = Manifest.model_json_schema(ref_template=f"#/components/schemas/{MANIFEST}.{{model}}")
    definitions = schema.pop("$defs")
    return {MANIFEST: schema} | {f"{MANIFEST}.{name}": part for name, part in definitions.items()}
