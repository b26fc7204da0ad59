import "./shared/styles/palette.css";
import "./shared/styles/base.css";
import "./shared/styles/parts.css";
import "./shared/styles/live.css";
import "./shared/styles/scene.css";
import "./shared/styles/captures.css";

import { StrictMode } from "react";
import { createRoot } from "react-dom/client";

import { App } from "./app/App";
import { dropToken } from "./shared/state/route";
import { applyTheme } from "./shared/state/theme";

applyTheme();
dropToken();
const root = document.getElementById("root");
if (root === null) throw new Error("index.html has no #root");
createRoot(root).render(
  <StrictMode>
    <App />
  </StrictMode>,
);
