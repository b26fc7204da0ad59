import "./styles/palette.css";
import "./styles/base.css";
import "./styles/parts.css";
import "./styles/live.css";
import "./styles/scene.css";
import "./styles/captures.css";

import { StrictMode } from "react";
import { createRoot } from "react-dom/client";

import { App } from "./app/App";
import { dropToken } from "./state/route";
import { applyTheme } from "./state/theme";

applyTheme();
dropToken();
const root = document.getElementById("root");
if (root === null) throw new Error("index.html has no #root");
createRoot(root).render(
  <StrictMode>
    <App />
  </StrictMode>,
);
